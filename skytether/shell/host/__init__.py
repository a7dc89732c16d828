"""What the machine gives: sockets, timers, files, and what not every system has."""
