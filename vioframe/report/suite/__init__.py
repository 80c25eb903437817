"""What a suite of the benchmark harness found: its results folder read back, summarised, drawn and laid out."""
