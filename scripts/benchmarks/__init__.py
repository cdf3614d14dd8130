"""What `make bench` measures: one module a subject, each row beside a peer or a limit measured in the same run."""
