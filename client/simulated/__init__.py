"""The simulated vehicle: what flies, the weather that it flies in, and what measures it."""
