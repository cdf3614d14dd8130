"""The double deep Q-network: what the arm learns with."""
