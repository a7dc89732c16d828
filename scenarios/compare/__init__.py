"""What `skytether compare` flies: each contender in each case, at the weights found for it."""
