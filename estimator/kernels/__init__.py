"""The compiled predict and update steps that all filters of the family share.

* `models.rigid_motion` moves the pose and its covariance.
* `scan_update.update_belief` takes in one scan. It calls `screen` (gates), `correct`
  and `add_landmark`; `correct` calls `linearise` (expected readings and Jacobians, from
  `models`), `absorb` (gain and covariance) and `compose` (the state).
* `batch`, `imagine` and `filters.drive_likelihood` take these steps for many runs,
  plans or noise settings in one call.
* `assignment_search` finds the most likely assignment of the readings of a scan.
"""
