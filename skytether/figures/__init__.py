"""Pictures, tables and pages made of flights, for commands, recordings and the laboratory."""
