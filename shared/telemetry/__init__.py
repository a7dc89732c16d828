"""Telemetry of a flight: records, their summaries, feeds for those who look on."""
