"""Training: state, update step, schedules, batches, checkpoints and the loop that joins them.

The program sees a model only through its *task* (`training.task.Task`). The loop knows no dataset, metric or picture:
it takes functions that evaluate and draw.
"""
