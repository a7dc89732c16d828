"""The scenarios that come with Skytether, one TOML file each."""
