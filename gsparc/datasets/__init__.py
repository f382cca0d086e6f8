"""One file a dataset: how it is read, and its `DataModule`, the `_target_` of conf/dataset."""
