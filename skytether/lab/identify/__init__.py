"""Identification of a vehicle: small steps of velocity, and the model that answers them alike.

steps: what is flown → flight: the endpoint that flies it → responses: what came of each step
→ fit: gain, time constant and dead time → told: words, table, picture and scenario
"""
