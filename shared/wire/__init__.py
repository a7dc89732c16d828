"""Wire: messages, secured channels, the handshake that opens them, and vehicles' keys."""
