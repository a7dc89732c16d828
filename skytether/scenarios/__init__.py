"""Built-in scenarios, one TOML file each; only `compare.toml` contains several, in tables."""
