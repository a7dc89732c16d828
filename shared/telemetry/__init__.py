"""Telemetry of a flight: records, summaries, and feeds for observers."""
