"""Pictures that tests draw but do not look at."""


def coarse_pictures(replace=setattr):
    """Pictures are then drawn whole, but with few pixels and in fixed places; else these take most of the time.

    replace: Sets an attribute, as `setattr` or the method of `pytest.MonkeyPatch` do.
    """
    from matplotlib.figure import Figure as Picture

    save = Picture.savefig

    def coarse(self, *where, **options):
        if options.get("format") != "rgba":  # frames of an animation have the size of its first
            options["dpi"] = 20
        engine, self._layout_engine = self._layout_engine, None  # for which all would be drawn twice
        save(self, *where, **options)
        self._layout_engine = engine

    replace(Picture, "savefig", coarse)
