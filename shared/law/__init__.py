"""Model and rules with which both ends predict: eq. (1)-(4), rule of flight,
eq. (11), and terms.
"""
