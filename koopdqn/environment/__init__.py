"""The environment: what the arm can do at each step, and what it is rewarded with."""
