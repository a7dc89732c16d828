"""The library: what `import skytether` offers beside the commands; `docs/python.md` shows it."""
