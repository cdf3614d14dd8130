"""Learning without intent model and reward, from demonstrations and labels: what koopdqn is compared with."""
