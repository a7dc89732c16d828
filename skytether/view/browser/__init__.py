"""Serving pages to browsers: sockets, threads and clocks are in here, and what is shown is not."""
