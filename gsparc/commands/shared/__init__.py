"""What the commands share: Hydra around a task, one run per folder, settings of stored runs,
output.
"""
