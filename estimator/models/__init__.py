"""Motion and measurement models: values, Jacobians and their compiled twins."""
