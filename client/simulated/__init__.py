"""Simulated vehicles: plant, weather and sensor."""
