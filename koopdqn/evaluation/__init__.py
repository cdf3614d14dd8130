"""Evaluation: what a policy is worth on held-out starts, beside what comes without learning."""
