"""Identification of a vehicle's model from small steps of velocity.

steps: experiment → flight: endpoint that flies it → responses: measurements of each step → fit:
gain, time constant and dead time → outcome: words, table, picture and scenario
"""
