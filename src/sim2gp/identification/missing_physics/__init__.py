"""Which effect does a simulator lack?"""
