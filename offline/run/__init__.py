"""How training runs: tasks, workers, checkpoints."""
