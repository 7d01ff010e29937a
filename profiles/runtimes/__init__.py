"""One file a runtime: load, run, say its version."""
