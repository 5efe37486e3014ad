"""Pictures that tests draw but do not look at."""


def coarse_pictures(replace=setattr):
    """Pictures are then drawn whole, but with few pixels and in fixed places; else these take most of the time.

    replace: Sets an attribute, as `setattr` or the method of `pytest.MonkeyPatch` do.
    """
    from matplotlib.figure import Figure as Picture
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    save = Picture.savefig

    def coarse(self, *where, **options):
        if options.get("format") != "rgba":  # frames of an animation have the size of its first
            options["dpi"] = 20
        save(self, *where, **options)

    replace(ConstrainedLayoutEngine, "execute", lambda self, picture: None)
    replace(Picture, "savefig", coarse)
