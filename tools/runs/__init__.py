"""One run: its inputs, scenario runner, log, verdict and pictures; live or in virtual time."""
