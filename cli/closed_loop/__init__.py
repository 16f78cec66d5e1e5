"""The stages of `nsde close-loop`: who flies, what is diagnosed, experiments, and the record.

machines       who flies: the simulated vehicle, a plant, a vehicle over MAVLink, or a person
experiments    design, fly, read, diagnose, until nothing is open or the budget is spent; what is said of each
loop           all stages; what is finished is not done again
record         close_loop.json, its text and its picture
"""
