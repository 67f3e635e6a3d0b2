from .hypotheses import HypothesisSlam as HypothesisSlam
from .hypotheses import manage as manage
from .managed_slam import ManagedSlam as ManagedSlam
from .policy import FieldOfView as FieldOfView
from .policy import LandmarkPolicy as LandmarkPolicy
