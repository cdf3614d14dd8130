"""Recordings as laboratories have them: recognised, read, and made into demonstrations by what is declared."""
