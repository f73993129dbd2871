"""Programs that take part in the comparison of throughput, each in a process of its own."""
