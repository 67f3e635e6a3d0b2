from .field_of_view import FieldOfView as FieldOfView
from .managed_slam import ManagedSlam as ManagedSlam
from .policy import LandmarkPolicy as LandmarkPolicy
