"""Dynamics and rules for prediction at both ends: model, eq. (1)-(4), rule of flight, eq. (11),
terms.
"""
