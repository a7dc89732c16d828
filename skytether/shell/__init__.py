"""What drives an endpoint: sockets, the clock, signals, processes and the command line."""
