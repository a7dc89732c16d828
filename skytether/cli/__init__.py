"""Commands that fly, show and repair flights; `skytether.lab` has commands of its own."""
