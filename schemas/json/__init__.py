"""JSON Schemas, generated from the message types."""
