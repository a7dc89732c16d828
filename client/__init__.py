"""The vehicle's side: choose an input from the horizons that arrived, fly it, report the state."""
