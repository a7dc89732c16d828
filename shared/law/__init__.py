"""Model and rules for predictions at both ends: eq. (1)-(4), rule of flight, eq. (11), terms."""
