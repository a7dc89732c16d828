"""Law of flight that both ends predict with: the model (1)-(4), the rule (11), and the terms."""
