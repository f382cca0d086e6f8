"""How the field learns: the LightningModule, initial values, schedules, effort, resuming."""
