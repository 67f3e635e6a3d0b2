"""Inner parts of filters, which several tests read."""


def closed_submaps(slam):
    """Return the closed submaps of a filter over submaps."""
    return graph_of(slam).closed


def graph_of(slam):
    """Return the graph of a filter over submaps."""
    return slam._graph


def present_submap(slam):
    """Return the submap that the robot is in."""
    return slam._active


def cached_submaps(slam):
    """Return the submaps that a folder's store holds in memory."""
    return closed_submaps(slam).store._cache


def neighbourhood_of(slam):
    """Return what knows the surroundings of the present submap."""
    return slam._neighbourhood


def map_of(slam):
    """Return the map of a compressed filter."""
    return slam._map


def filters_of(slam):
    """Return the hypotheses that a managed filter has made, and the spare ones."""
    return slam._made, slam._spare


def spied(monkeypatch, owner, name, note):
    """Call a function with the arguments of a method before every call of it."""
    method = getattr(owner, name)

    def noted(*arguments):
        note(*arguments)
        return method(*arguments)

    monkeypatch.setattr(owner, name, noted)
