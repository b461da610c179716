"""The study: the table of experiments, and what is measured and drawn from it."""
