"""A short path and a small agent, by which every command takes a second or two."""

SMALL = (
    "task.waypoints=[[0.45,-0.20,0.45],[0.42,-0.16,0.46],[0.38,-0.12,0.47]]",
    "task.start_half_range_m=[0.01,0.01,0.01]",
    "task.variation_m=0.002",
    "demo.count=3",
    "demo.sample_seconds=0.05",
    "intent.count=60",
    "agent.network.hidden=[32]",
    "agent.network.fourier_features=32",
    "agent.batch=64",
    "agent.warm_up=400",
    "agent.episodes_at_once=16",
    "train.check_every=40",
)

# Where any policy will do: it counts as learned at its first check, whatever that finds.
SOON = (*SMALL, "train.check_success=0.0", "train.checks_to_learn=1")
