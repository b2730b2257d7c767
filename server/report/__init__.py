"""Reports: the measured walkthrough and the accuracy report of `solidcloud accuracy`."""
