; A system that does not say which processors a thread may run on.
define internal i64 @processors(i64 %most) {
  ret i64 %most
}
