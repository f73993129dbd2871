"""How closely sets of coefficients meet recordings: nothing is fitted here."""
