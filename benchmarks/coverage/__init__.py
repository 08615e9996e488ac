"""Does the stated uncertainty of poses and lengths cover the errors?"""
