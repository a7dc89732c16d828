"""netem: the bad network between clients and a server, a UDP proxy that never reads its packets."""
