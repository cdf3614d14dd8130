"""Motions to look at: a page that opens anywhere, a film, and MuJoCo's own viewer."""
