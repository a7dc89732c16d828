"""What Skytether costs, measured beside what others cost in the same run."""
