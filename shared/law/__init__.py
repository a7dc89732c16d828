"""Law of flight that both ends predict with: model, eq. (1)-(4), rule, eq. (11), and terms."""
