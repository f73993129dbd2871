"""The page's sections: of what the result folder holds, a `Section`; None if that is nothing."""
