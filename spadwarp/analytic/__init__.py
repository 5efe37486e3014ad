"""The analytic simulator: numbers without photon transport."""
