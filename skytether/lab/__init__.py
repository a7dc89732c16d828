"""Laboratory: figures, comparisons and searches made from many flights."""
