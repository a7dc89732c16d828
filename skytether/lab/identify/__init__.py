"""Identification of a vehicle's model from small steps of velocity.

`steps` commands the experiment, `flight` is the endpoint that flies it, `responses` extracts the
measurements of each step, `fit` finds gain, time constant and dead time, and `outcome` makes
sentences, table and scenario of the results.
"""
