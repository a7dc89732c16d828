"""The MPC of the paper: problem (5)-(9), solvers (10), and the hierarchy (14), (15)."""
