"""What drives an endpoint in real time: datagrams, streams, changes, and files beside it."""
