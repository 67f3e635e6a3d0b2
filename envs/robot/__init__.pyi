from .drive_equation import displacement as displacement
from .unicycle_body import UnicycleBody as UnicycleBody
from .vector_bodies import UnicycleBodies as UnicycleBodies
from .wall_contacts import WallContacts as WallContacts
