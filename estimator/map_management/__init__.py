"""Which landmarks a map holds: association, confirmation, removal, merging.

``landmark_policy`` says what is wanted and ``managed`` does it around any filter.
"""
