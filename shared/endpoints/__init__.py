"""What server, client and netem are: endpoints, driven by datagrams and time only."""
