"""A vehicle with a standby server, which leads when the first server is silent."""
