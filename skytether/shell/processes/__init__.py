"""Process of an endpoint: its log, metrics and record, from start to end."""
