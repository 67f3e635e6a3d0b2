"""The compiled predict and update steps that all filters of the family share."""
