"""Library behind `import skytether`; see docs/python.md."""
