"""Training: the paper's schedule, on one processor or many, resumable at any step."""
