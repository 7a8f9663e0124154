"""The parts of the page: each module makes one, and says nothing where the study has nothing for it."""
