"""Pictures, tables and pages of flights, for commands, recordings and the laboratory."""
