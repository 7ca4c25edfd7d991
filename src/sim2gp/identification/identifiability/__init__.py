"""Which parameters and combinations of them do the data determine?"""
