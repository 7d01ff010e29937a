"""The networks: arch, layers, both families, op lists, checkpoints, export, metrics."""
