"""Commands that fly, show and convert flights; `skytether.lab` has further commands."""
