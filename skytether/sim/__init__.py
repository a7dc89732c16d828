"""Virtual time: the endpoints that fly over UDP, on a clock that jumps from event to event."""
