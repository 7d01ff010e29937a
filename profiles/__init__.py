"""The devices: profile files and their schema, the latency model, measuring and fitting."""
