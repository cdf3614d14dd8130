"""The report: the paper's figures and tables beside ours, from finished runs."""
