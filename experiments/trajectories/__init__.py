"""Generate data sets of trajectories, written in shards, and read them.

controllers → driven episodes → trajectory → formats → shard folder, manifest → dataset
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
