"""Research tools: gain design, studies and benchmarks. A robot does not need them."""
