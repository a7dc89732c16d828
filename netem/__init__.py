"""The bad network between them: a UDP proxy that delays, reorders and loses what it never reads."""
