"""Wire: messages, sealed channels, the handshake that opens them, and vehicles' keys."""
