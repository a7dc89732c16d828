"""Built-in scenarios, one TOML file each; only `compare.toml` has several scenarios, in tables."""
