"""The command line: Hydra, commands, run folders, and what is said at the terminal; nothing below it knows Hydra."""
