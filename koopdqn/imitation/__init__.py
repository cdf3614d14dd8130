"""Learning from demonstrations alone, without intent model and oracle: what koopdqn is compared with."""
