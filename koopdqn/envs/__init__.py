"""The environment as other libraries know it."""
