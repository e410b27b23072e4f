"""Many captures: found, each learnt by an ia-ingest process of its own, and summed up."""
