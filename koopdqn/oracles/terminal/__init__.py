"""A person at a terminal teaches the arm: the screen, its picture, the keys."""
