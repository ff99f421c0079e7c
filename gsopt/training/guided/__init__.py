"""Training with a prior: the run's session, the guard, the comparison of prompts."""
