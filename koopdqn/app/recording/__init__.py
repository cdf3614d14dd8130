"""A person shows a task with the keyboard: keys move the arm, and the path becomes a demonstration."""
