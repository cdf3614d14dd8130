"""Feedback: right or wrong, from a scripted oracle or a person, where the intent model is not trusted."""
