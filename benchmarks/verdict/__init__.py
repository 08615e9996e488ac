"""Do the limits of sl-eval's verdict tell surfaces that are right from those that are not?"""
