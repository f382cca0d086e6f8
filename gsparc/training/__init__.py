"""How the field learns: the LightningModule, initial values, schedules, time budget, checkpoints to resume from."""
