"""Who answers: a script, a person at the terminal, a file or a program; and the journal of their answers."""
