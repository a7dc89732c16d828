"""The scenarios that come with Skytether, a TOML file each; `compare.toml` holds many in tables."""
