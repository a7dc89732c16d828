"""What a process around an endpoint is: its log, metrics and record, from start to end."""
