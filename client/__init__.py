"""The client: receives horizons, chooses the input of each step, flies it, and reports the
state.
"""
