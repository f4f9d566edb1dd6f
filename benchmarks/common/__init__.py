"""What the benchmarks share: the machine, results and tables, timings, plots, captures, scenes."""
