"""A person shows at the keyboard where a learned path should go instead."""
