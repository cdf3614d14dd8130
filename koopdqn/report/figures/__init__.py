"""The report's figures, one file a kind; each function writes one PNG."""
