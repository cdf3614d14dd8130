"""Evaluation: a policy on held-out starts, beside baselines that learn nothing."""
