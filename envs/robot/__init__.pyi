from .unicycle_body import UnicycleBody as UnicycleBody
from .vector_bodies import UnicycleBodies as UnicycleBodies
