"""A camera measured from recordings: its noise, its MTF and the figures of EMVA 1288."""
