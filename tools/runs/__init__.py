"""One run: what it is to be, who leads it, its log, its verdict and its picture."""
