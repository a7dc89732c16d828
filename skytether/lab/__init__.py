"""Laboratory: studies, comparisons and searches made of many flights, and their figures."""
